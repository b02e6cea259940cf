"""The methods, by their authors' names, and the two adjustments."""
