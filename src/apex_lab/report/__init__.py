"""A report of runs as one HTML file: `python -m apex_lab.report`.

asked      the command
assemble   from its jobs to the values of the page
contents   those values: configurations, counts, panels of curves, pictures, settings
facts      commits, data, versions and hardware of the runs
curves     curves.csv of many seeds: thinned, mean and spread
charts     curves as geometry
pictures   film strips and movies inside the page, within a limit of bytes
settings   resolved configurations, and what differs
tables     the paper's tables as text
page       all of it as HTML (page/: template, style, script)
"""
