"""What moves before fixed cameras, apart from what stands still."""
