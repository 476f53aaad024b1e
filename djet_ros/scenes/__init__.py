"""
Rendered scenes with exact ground truth.

A scene is a world of textured planar panels, a trajectory, and a camera with its effects.
"""

from djet_ros.scenes.catalogue import make_scene, SCENES
from djet_ros.scenes.pair import render_pair, ScenePair
from djet_ros.scenes.scene import Scene
from djet_ros.scenes.sequence import render_sequence

__all__ = ['SCENES', 'Scene', 'ScenePair', 'make_scene', 'render_pair', 'render_sequence']
