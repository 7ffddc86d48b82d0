"""Studies: values of configuration keys chosen by validation scores, on Optuna.

settings   the keys of a study (conf/tune.yaml)
space      swept words of the command line -> what Optuna draws from
study      one checked command, its identity, and the words of a trial
samplers   draws that depend on the seed and the trial's number
storage    journal file, SQLite, PostgreSQL; heartbeats
trials     which trials count, which must be run again
trial      one trial: its runs, what they report, pruning
workers    the loop of one worker
plots, tuned_file    what a study leaves
"""
