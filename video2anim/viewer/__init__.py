"""Looking at a scene: a software renderer that needs nothing, and the open3d viewer."""

from video2anim.viewer.scene_view import SceneView
from video2anim.viewer.view import screenshot, view

__all__ = ["SceneView", "screenshot", "view"]
