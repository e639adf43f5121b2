"""Plans of jobs: the fastest of the settings that meet a tolerance."""
