"""Problems and solves in the browser. Needs the extra `view`."""
