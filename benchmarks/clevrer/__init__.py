"""Reader and writer of CLEVRER's files (Yi et al., ICLR 2020): videos, annotations, mask proposals.

Formats as the data set's README and its published readers have them. Nothing of the data set is shipped here.
"""

from benchmarks.clevrer.annotation import Annotation, load_annotation
from benchmarks.clevrer.cut import Cut, cut_video
from benchmarks.clevrer.proposals import Proposals, load_proposals

__all__ = ["Annotation", "Cut", "Proposals", "cut_video", "load_annotation", "load_proposals"]
