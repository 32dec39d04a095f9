"""Files for other programs: GLB, USD, BVH, AMASS npz, preview video and report.

Importing this package is cheap; the writers load their libraries when they run.
"""

from video2anim.export.formats import FORMATS, ExportScene, write_format

__all__ = ["FORMATS", "ExportScene", "write_format"]
