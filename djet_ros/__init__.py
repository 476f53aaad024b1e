"""D-JET: visual odometry by differential pose optimisation in descriptor space."""

__version__ = '0.3.0'
