"""Many projects: found, stitched side by side, resumed, reported."""
