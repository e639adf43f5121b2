"""Pictures of results. A plot takes plain results and imports no workflow."""
