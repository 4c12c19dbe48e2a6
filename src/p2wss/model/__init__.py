"""Stage model: the training of Point2WSS (paper, sections 4 and 5.2)."""

from p2wss.model.task import augmented, keeps_patches, save, train

__all__ = ["augmented", "keeps_patches", "save", "train"]
