"""Results as people read them: texts, tables, files and pictures."""
