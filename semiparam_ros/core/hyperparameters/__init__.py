"""Hyperparameters from the initial window: the marginal likelihood and its maximum, or a validation set."""
