"""The commands of ``gpuvision``, one module and function each; `gpuvision.cli.main` registers them.

A command imports what it needs inside its function, so that ``gpuvision --help`` answers at once.
"""
