"""Files: cameras, designs, TOML, tables, images; read with every mistake named, and written whole or not at all."""
