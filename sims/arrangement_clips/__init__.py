"""Training data for the arrangement task: clips of its objects on its table, seen by its camera, without the arm."""
