"""Exchange with other programs: databases and models of every COLMAP version, the native mapper."""
