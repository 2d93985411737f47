"""The web pages: rendered here from templates, with every style and script of our own."""
