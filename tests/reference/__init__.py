"""NumPy twins of the kernels: one function per kernel, under its name, one module per .cl file.

Written from the formulas in float64, with other means than the kernels (sums as matrices, padding
instead of border tests), and each checked once against brute force or SciPy in tests/test_<module>.py.
"""
