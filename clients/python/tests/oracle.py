"""Changed texts of model files."""

import re


def with_fourth_observation(text: str) -> str:
    """Adds an observation that no state shows to the text of a model with three observations."""
    text = re.sub(r"(observed_as = \[[^]]*)\]", r"\1, 0.0]", text)
    fourth = '    { name = "none", color = "#000000" },\n]'
    if "[[observations]]" in text:
        return f'{text}\n[[observations]]\nname = "none"\ncolor = "#000000"\n'
    head, rest = text.split("observations = [", 1)
    return f"{head}observations = [{rest.replace(']', fourth, 1)}"
