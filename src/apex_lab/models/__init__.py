"""One folder per model; each is a `SceneModel`."""
