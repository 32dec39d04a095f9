"""The renderer of synthetic shots: ray casting, procedural textures, soft shadows, camera lens and sensor."""

from video2anim.lab.synth.render.lens import distort, undistort
from video2anim.lab.synth.render.picture import Picture
from video2anim.lab.synth.render.renderer import Renderer
from video2anim.lab.synth.render.sensor import Sensor

__all__ = ["Picture", "Renderer", "Sensor", "distort", "undistort"]
