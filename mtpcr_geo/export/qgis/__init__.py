"""What QGIS opens: a project of the files of a run, and the plugin that calls the command."""
