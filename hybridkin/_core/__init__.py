"""What stands on nothing else: the interface of models, arrays, and entire functions."""
