"""The object arrangement task with a model's perception: `python -m apex_lab.arrange` (docs/arrangement.md).

perception  image -> detections: a trained model, a yardstick, or the simulator's labels
scenarios   all scenarios of a command on all cores: workers that are recycled, replaced when they die, and timed
worker      what one of these processes does
results     files of scenarios, and their summary as the paper's table
film        a scenario as a video
"""
