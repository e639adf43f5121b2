"""Board artwork from Gerber and Excellon files: layers, shapes, straight edges."""
