"""Receives webhooks of modalwatch on 127.0.0.1:9999 and prints those whose signature is right. SECRET=whsec_… python3 receive_webhooks.py"""
import base64, hashlib, hmac, http.server, json, os, time

KEY = base64.b64decode(os.environ["SECRET"].removeprefix("whsec_"))

class Receiver(http.server.BaseHTTPRequestHandler):
    def do_POST(self):
        body, sent_at = self.rfile.read(int(self.headers["content-length"])), self.headers["webhook-timestamp"]
        signed = f'{self.headers["webhook-id"]}.{sent_at}.'.encode() + body
        expected = "v1," + base64.b64encode(hmac.new(KEY, signed, hashlib.sha256).digest()).decode()
        genuine = any(hmac.compare_digest(expected, given) for given in self.headers["webhook-signature"].split())
        genuine = genuine and abs(time.time() - int(sent_at)) < 300
        self.send_response(204 if genuine else 401)
        self.end_headers()
        event = json.loads(body)
        print("genuine" if genuine else "FORGED", self.headers["webhook-id"], event["type"], json.dumps(event["data"]), flush=True)

http.server.HTTPServer(("127.0.0.1", 9999), Receiver).serve_forever()
