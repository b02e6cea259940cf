"""Use of an identified robot: compensation, verification, measurement poses."""
