"""Tables, workbook and printed page of a round."""
