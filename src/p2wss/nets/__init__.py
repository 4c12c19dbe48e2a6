"""The two networks of the paper, as plain torch modules, and the parameter tokenizer. Pure, no I/O."""
