"""From a text or a pixel to Gaussians: one-step, canonical and anchored queries; outliers; masks of a selection."""
