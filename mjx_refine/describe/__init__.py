"""A scene's motion in words: told by rules from its simulation, read back, and checked against it."""

from mjx_refine.describe.check import Fault, check_description, check_statements, faults
from mjx_refine.describe.describe import Description, describe
from mjx_refine.describe.parse import Parsed, parse_description, parse_sentences
from mjx_refine.describe.record import Record, record
from mjx_refine.describe.statements import Statement

__all__ = [
    "Description",
    "Fault",
    "Parsed",
    "Record",
    "Statement",
    "check_description",
    "check_statements",
    "describe",
    "faults",
    "parse_description",
    "parse_sentences",
    "record",
]
