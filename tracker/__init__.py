"""Video frames -> Track: landmarks, head model, camera, fit, overlay."""
