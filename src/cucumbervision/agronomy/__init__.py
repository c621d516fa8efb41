"""What lengths mean to a grower: crop profiles, grades, growth, forecast, picking and work."""
