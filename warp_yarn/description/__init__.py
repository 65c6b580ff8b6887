"""What users describe: weaves, yarns, cloths, scenes, and the index arrays that follow from them.

NumPy alone; a scene knows the terms by their names.
"""
