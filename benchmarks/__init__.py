"""The benchmark suite for all published figures: run `python -m benchmarks [NAME ...]` in the repository's root."""
