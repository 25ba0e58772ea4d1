"""Virtual views of a scene of Gaussians that comes without photographs."""
