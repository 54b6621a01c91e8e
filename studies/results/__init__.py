"""The figures that pages state, each table in a file, and the pages made of them."""
