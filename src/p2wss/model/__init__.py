"""Stage model: the training of Point2WSS (paper, sections 4 and 5.2)."""

from p2wss.model.task import augmented, preserves_patches, train

__all__ = ["augmented", "preserves_patches", "train"]
