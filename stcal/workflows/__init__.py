"""Work that needs several systems at once; nothing below composes systems."""
