"""Sub-pixel detection of target patterns: dot grids, chessboards and line grids."""
