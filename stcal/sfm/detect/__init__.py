"""From pixels to labelled circle centres: candidates, centring, faces, board."""
