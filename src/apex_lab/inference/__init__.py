"""What evaluation, validation, prediction and arrangement share: a loaded model, and how it is called."""
