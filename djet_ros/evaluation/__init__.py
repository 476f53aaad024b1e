"""
Evaluation against ground truth, pair by pair: the paper's tables and figures on any data.

Sources (sequences with ground truth) are cut into chunks of frame pairs; every entrant (a method
with its parameters) estimates every pair on the same matches; records of all pairs become tables,
plots and one page.
"""
