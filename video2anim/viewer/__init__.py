"""Looking at a scene: a software renderer that needs nothing, and the open3d viewer."""

from video2anim.viewer.view import SceneView, screenshot, view

__all__ = ["SceneView", "screenshot", "view"]
