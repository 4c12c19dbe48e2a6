"""Stage dvae: the discrete VAE that turns patches of points into tokens (paper, section 4.2)."""

from p2wss.dvae.task import train

__all__ = ["train"]
