"""A fuzzer for all readable formats: break files with knowledge of their structure, and run commands on them.

    python -m tests.fuzz --minutes 30                 # run for 30 minutes; findings are printed and kept in build/fuzz
    python -m tests.fuzz --seed 7 --case 1234         # repeat one case of a finding

A case is a number. With the seed, it selects the format, the file and the damage (corpus, breakage), so that it is the
same on every machine. Worker processes try the cases (worker), and the main process watches them (campaign): a process
that dies or hangs is a finding, too. trial defines what counts as a finding.
"""
