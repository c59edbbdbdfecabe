"""The command line: one click module per command. It has no arithmetic and no try blocks."""
