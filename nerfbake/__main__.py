"""`python -m nerfbake`."""

from nerfbake.cli.main import main

main()
