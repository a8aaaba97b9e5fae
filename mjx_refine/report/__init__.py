"""What a refinement leaves in its folder: scene, numbers, report and animation."""

from mjx_refine.report.doubts import warnings
from mjx_refine.report.files import write_result

__all__ = ["warnings", "write_result"]
