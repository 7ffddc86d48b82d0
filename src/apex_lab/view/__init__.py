"""Drawings of a model's output for a video: film strips, movies, panels per component, curves."""

from apex_lab.view.curves import curve_page
from apex_lab.view.film import film_strip
from apex_lab.view.item import Item
from apex_lab.view.movie import movie
from apex_lab.view.panels import component_panels
from apex_lab.view.render import render_all

__all__ = ["Item", "component_panels", "curve_page", "film_strip", "movie", "render_all"]
