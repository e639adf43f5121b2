"""File formats: every file that gpuvision reads or writes."""
