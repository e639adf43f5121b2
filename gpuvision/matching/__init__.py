"""Visual servoing: from a frame of known artwork, or of a field, to a pose with its covariance."""
