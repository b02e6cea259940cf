"""From models without unit to calibrated faces: adjustment, scale, frames, chaining, covariances."""
