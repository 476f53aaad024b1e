"""
Rendered scenes with exact ground truth.

A scene is a world of textured planar panels, a trajectory, and a camera with its effects.
"""

from djet_ros.lab.scenes.catalogue import make_scene, SCENES
from djet_ros.lab.scenes.pair import render_pair, ScenePair
from djet_ros.lab.scenes.scene import Scene
from djet_ros.lab.scenes.sequence import render_sequence

__all__ = ['SCENES', 'Scene', 'ScenePair', 'make_scene', 'render_pair', 'render_sequence']
