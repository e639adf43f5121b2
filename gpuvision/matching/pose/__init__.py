"""Pose estimation: robust pose from features, fused board pose, coarse registration."""
