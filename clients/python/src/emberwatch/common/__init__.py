"""What every room uses: checks of arguments, paths, shared numbers."""
