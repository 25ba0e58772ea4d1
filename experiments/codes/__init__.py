"""The paths to the Gaussians' codes that `experiments.distillation` compares."""
