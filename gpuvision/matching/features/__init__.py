"""Features in images: calipers (rulers), blobs, line fits, and their choice from the artwork."""
