"""Writes every generated page: ``python -m docs.generate``. The pages are made in docs/tools.

``python -m docs.gallery`` makes the pictures of docs/gallery.md.
"""

from docs.tools.pages import main

if __name__ == "__main__":
    main()
