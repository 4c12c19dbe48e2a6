"""Stages dvae and model: how both networks are trained, from the crops to the weights to keep."""
