"""Drawn towns whose true roofs are known, and LiDAR of towns, in the file formats of ``p2wss towns``;
``python benchmarks/towns.py`` draws them. The benchmarks measure on them, and the shipped networks were trained on
them."""
