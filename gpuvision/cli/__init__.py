"""Commands of ``gpuvision``: one module and one function each; `gpuvision.cli.main` registers them.

A command imports heavy modules inside its function, so that ``gpuvision --help`` answers at once.
"""
