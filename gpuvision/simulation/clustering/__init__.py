"""Error-bounded clustering of lights (in the manner of lightcuts)."""
