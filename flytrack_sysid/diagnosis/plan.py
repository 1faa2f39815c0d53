"""Placeholder until the plan branch is merged."""


def advise(problem, found, outlook, wanted):
    return {name: "speeds" for name in wanted}
