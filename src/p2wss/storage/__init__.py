"""Files: written atomically, with checksums, checked when read; one module per file schema in `schemas/`."""
