"""Robot localisation on a field with marked lines."""
