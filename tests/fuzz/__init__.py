"""A fuzzer over every readable format: files broken by structure, and what commands then do with them.

    python -m tests.fuzz --minutes 30                 # so long; findings are printed and kept in build/fuzz
    python -m tests.fuzz --seed 7 --case 1234         # one case again, as its finding names it

A case is a number: with the seed it says the format, the file that is broken and how (corpus, breakage), so that it
comes out the same anywhere. It is tried in a process of its own (worker) that is watched from outside (campaign): a
process that dies or hangs is a finding, too. What counts as one stands in trial.
"""
