"""
Measuring: evaluation against ground truth, closure, speed, memory, figures, rendered scenes.

Sources (sequences with ground truth) are cut into chunks of frame pairs; every method estimates
every pair on the same matches; records of all pairs become tables, plots and one page.
"""
