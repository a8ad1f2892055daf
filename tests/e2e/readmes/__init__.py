"""The commands of the READMEs, and the person who types them."""
