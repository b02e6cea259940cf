"""Adjustment of models without unit to calibrated faces: scale, frames, chaining, covariances."""
