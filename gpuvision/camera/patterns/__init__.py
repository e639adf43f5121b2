"""Dot grids, chessboards and line grids in images, found sub-pixel."""
