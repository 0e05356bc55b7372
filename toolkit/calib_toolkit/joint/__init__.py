"""The joint estimator: every reading once, in one likelihood over all sensors, with the motion itself latent."""
