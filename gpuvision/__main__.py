"""``python -m gpuvision``: the command ``gpuvision``."""

from gpuvision.cli.main import main

if __name__ == "__main__":
    main()
