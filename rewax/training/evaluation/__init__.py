"""Episodes of trained policies: returns, recordings, pictures, landscapes."""
