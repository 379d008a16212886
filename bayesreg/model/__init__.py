"""The Bayesian model: similarity, elastic prior, parameter priors, skull constraint."""
