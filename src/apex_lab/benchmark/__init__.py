"""What `python -m apex_lab.bench` measures: speed, seconds by part, peak memory, and APEX against its plain variant."""
