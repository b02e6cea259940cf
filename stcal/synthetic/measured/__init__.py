"""What a system would be handed of a scene, with known truth and without pixels; for studies and tests."""
