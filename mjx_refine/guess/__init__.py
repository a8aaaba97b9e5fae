"""Starting samples from an observation alone, where no language model is at hand."""

from mjx_refine.guess.guess import guess_scenes

__all__ = ["guess_scenes"]
