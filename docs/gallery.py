"""Makes the pictures of docs/gallery.md and README.md anew: ``python -m docs.gallery``. They are made in docs/tools."""

from docs.tools.gallery import main

if __name__ == "__main__":
    main()
