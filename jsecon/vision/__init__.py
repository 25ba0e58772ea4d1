"""What looks at pixels, behind three small protocols: segmenters, trackers, embedders."""
