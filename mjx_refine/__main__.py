"""``python -m mjx_refine`` is ``refine``."""

from mjx_refine.cli import main

if __name__ == "__main__":
    main()
