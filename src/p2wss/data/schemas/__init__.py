"""The files that stages hand to each other, a module each: columns with their meaning and unit."""
