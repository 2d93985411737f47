"""Web pages: rendered on the server from templates, with local styles and scripts only."""
