"""A QGIS plugin: the verbs of mtpcr-geo as algorithms of the Processing toolbox.

QGIS runs these modules in its own Python; they import nothing of the package beside them.
"""


def classFactory(iface):
    """Return the plugin."""
    from .plugin import Plugin

    return Plugin()
