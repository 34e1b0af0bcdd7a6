"""The bundled robots: a folder each, with the URDF, its preset and its sphere file."""
