"""Scenes changed by instructions in words; what an instruction does not speak of stays as it is, byte for byte."""

from mjx_refine.edit.edit import Edit, NotUnderstoodError, edit
from mjx_refine.edit.flo import flo_bytes, write_flo
from mjx_refine.edit.preview import gif_sheet, png_sheet
from mjx_refine.edit.rules import FORMS

__all__ = ["FORMS", "Edit", "NotUnderstoodError", "edit", "flo_bytes", "gif_sheet", "png_sheet", "write_flo"]
