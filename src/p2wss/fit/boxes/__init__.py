"""Boxes on a roof and in it: dormers, recesses, chimneys, open ground."""
