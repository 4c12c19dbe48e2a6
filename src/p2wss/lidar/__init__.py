"""Airborne LiDAR, simulated: the survey, its pulses, the cast, what a sensor records; and the cropping
kernel.

Arrays in, arrays out: nothing here reads or writes a file. ``docs/lidar.md`` explains the model.
"""
