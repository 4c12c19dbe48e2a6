"""Stage model: the training of Point2WSS (paper, sections 4 and 5.2)."""

from p2wss.model.task import augment_batch, train

__all__ = ["augment_batch", "train"]
