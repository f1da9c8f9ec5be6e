"""The robustness benchmark: labelled runs with a known answer, and runs that have none.

    for case in cases(["pairs", "repeating"], SuiteOptions(data=Path("data"), cache=Path("cache"))):
        row = run_case(case)

`suites` lists the runs, `cases` says what one is, `runner` makes one into a row, `drive` spreads them over
processes, and `results` keeps and sums up the rows.
"""
