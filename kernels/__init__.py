"""The OpenCL C sources, one stem per operation; ``gpuvision.host.program`` builds them."""
