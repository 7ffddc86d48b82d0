"""The object arrangement task with a model's perception: `python -m apex_lab.arrange` (docs/arrangement.md).

perception  image -> detections: a trained model, a yardstick, or the simulator's labels
benchmark   all scenarios of a command: what was done before, what is left, the summary
pool        worker processes on all cores: recycled, timed, replaced when they die
worker      what one of them does
task        what they exchange
results     files of scenarios, and their summary as the paper's table
film        a scenario as a video
"""
