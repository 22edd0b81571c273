"""``python -m sb3_gcr.zoo``."""

from sb3_gcr.zoo.commands import main

main()
