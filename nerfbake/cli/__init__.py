"""Words: one small click file a command; no arithmetic, no try."""
