"""video2anim: a monocular video of a person among objects, turned into a metric scene and an animation."""

__version__ = "0.1.0"
