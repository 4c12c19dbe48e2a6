"""From fitted parts to one closed mesh, and what adjusts it afterwards."""
