"""Files: cameras, designs, TOML, tables, images. Readers name every mistake; writing is all or nothing."""
