"""The node `estimator`: topics, parameters, services, diagnostics."""
