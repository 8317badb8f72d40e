-- A service that ran lost its time limit by that; replaced since, it is what one goes back to.
UPDATE assignments SET ran = 1 WHERE phase = 'superseded' AND expires_at_ms IS NULL;
