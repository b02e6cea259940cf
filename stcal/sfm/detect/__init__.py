"""Detection of labelled circle centres in images: candidates, centring, faces, board."""
