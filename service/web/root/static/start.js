// A separate file, because the content security policy forbids inline scripts. validatorUrl is null, because the page
// would otherwise send the document to a validator of Swagger.
SwaggerUIBundle({url: "/openapi.json", dom_id: "#swagger-ui", deepLinking: true, validatorUrl: null});
